"""A world that shares no code with the library: parts, arm, cameras, contact, and what goes wrong there."""
