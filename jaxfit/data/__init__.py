"""The containers of the project: observations that go in, solutions that come out, and their files."""
