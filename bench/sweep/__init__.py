"""From configuration to rows: experiments, their grids of cells, and the running and storing of them."""
