"""The command line: `main` finds the command, each command is a short program over the library."""
