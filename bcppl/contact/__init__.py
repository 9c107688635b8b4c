"""Contact: rigid-body physics, quasi-static contact, and contact sensing from a wrench."""
