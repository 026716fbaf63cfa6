"""The command line: arguments and messages; what a command does is in the rooms below."""
