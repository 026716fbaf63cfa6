"""The outside world's files, read into the survey's own terms."""
