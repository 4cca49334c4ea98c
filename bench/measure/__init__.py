"""Numbers from problems: references, statistics, noise, timing and gradient checks, pure where they can be."""
