"""The parts of the command line: the story in two acts, and the diagnosis of a CSV file."""
