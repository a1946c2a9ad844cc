"""The command line: a spec in, a result folder out."""
