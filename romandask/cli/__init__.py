"""Command line: arguments and messages. The lower layers of the package do the work."""
