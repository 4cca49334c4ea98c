"""How touching bodies push on each other."""
