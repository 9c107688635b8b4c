"""Which sites depend on new values: equality of what they were computed from, part by part."""
