"""From cells to rows: plan, workers, launchers, references and the store."""
