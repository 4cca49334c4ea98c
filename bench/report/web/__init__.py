"""The page of an experiment: ``report.html``, a single file that needs no network."""
