"""Studies that come with the package, a folder each: measurements per cell, and their tables, charts and page."""
