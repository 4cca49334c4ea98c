"""Contact laws compute forces or impulses between bodies in contact."""
