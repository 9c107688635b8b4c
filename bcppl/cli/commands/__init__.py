"""The commands, one file for each or for a few that share what they do."""
