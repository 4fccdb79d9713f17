"""The commands, a module a group: each is one short function that calls the library and prints what came of it."""
