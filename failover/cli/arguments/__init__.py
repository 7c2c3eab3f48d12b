"""Arguments of the verbs: one function for each verb adds them to the verb's parser.

The files are cut by what the verbs are about; `failover.cli.parser` names the function of each verb, and loads the file of the
verb that was typed. Only this package and `failover.cli.parser`, which has the verbs' help and examples, know argparse.
"""
