"""One person in several recordings: their times and places against each other, and one body adjusted to all views."""
