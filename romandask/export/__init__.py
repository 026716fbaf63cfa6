"""The way out: files of a survey in the formats that other programs read."""
