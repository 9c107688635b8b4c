"""bcppl: finding where a part is by looking at it and touching it."""
