"""Files, processes and progress."""
