"""The command line: one module per group of commands; a command calls the library and prints the result."""
