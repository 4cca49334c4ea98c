"""Contact laws: how touching bodies push on each other."""
