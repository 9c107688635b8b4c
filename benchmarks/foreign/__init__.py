"""A world that shares no code with the library: parts, arm, cameras and contact, and what goes wrong there."""
