"""From configuration to cells: experiments, their grids, identity keys, columns, and the contract of a study."""
