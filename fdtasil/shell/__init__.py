"""The commands of a shell, read from the functions of the library."""
