"""Published bird models, read from the files that their authors released."""
