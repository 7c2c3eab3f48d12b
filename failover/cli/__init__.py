"""The command line: one function per verb, one parser, one package that draws."""
