"""Keeps collection out of the folders that belong to the package `bcppl`.

`models` and `inference` are imported as `bcppl.models` and `bcppl.inference` only: collected from the top, or
through the links by path, every module would exist twice.
"""

collect_ignore = ["models", "inference", "bcppl/models", "bcppl/inference"]
