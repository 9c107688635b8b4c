"""Files that `bcppl new` writes, `NAME` in them replaced."""
