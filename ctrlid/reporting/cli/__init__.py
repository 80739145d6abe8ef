"""The parts of the command line: two demonstrations, and the diagnosis of a CSV file."""
