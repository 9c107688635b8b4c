"""Planning: touches, slides, searches and insertions that an arm can carry out."""
