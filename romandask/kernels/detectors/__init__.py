"""From expected light to what a detector reads, and back."""
