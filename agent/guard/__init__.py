"""The guard process, one per component: parent of the program, owner of its streams and its lease. It outlives the agent."""
