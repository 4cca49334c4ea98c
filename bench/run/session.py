"""Opens the session of a run, in which reference gradients are computed once and stored."""

from __future__ import annotations

from bench.experiment import session
from bench.experiment.experiment import Experiment
from bench.run.references import References


class RunSession(session.Session):
    """The session of one run, as studies see it, with the run's own references."""

    references: References

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self.problems = session.Problems(experiment.compile_cache)
        self.references = References(experiment, self.problems)
