"""The event log: the record of a decision, and the merge of several robots' logs into one. Pure."""
