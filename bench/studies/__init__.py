"""The built-in studies, one package each: what to measure per cell, and the tables, charts and page to write."""
