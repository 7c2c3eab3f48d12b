"""The command line: one function per verb, one parser, one place that draws."""
