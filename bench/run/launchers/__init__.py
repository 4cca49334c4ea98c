"""Launchers: where tasks run. All give the same rows, and each can resume a sweep that another one started."""

from __future__ import annotations

from bench.experiment.experiment import Experiment
from bench.run.launchers.launcher import Launcher, local_launcher


def launcher_of(experiment: Experiment, timed: bool = False, kind: str = "") -> Launcher:
    """Return the experiment's launcher.

    Timed tasks run one at a time and have a machine to themselves. All machines are of the ``kind`` given, or of the
    kind of the first machine. Other tasks run in parallel, each on one thread.
    """
    match experiment.execution.launcher:
        case "ray":
            from bench.run.launchers.ray import RayLauncher

            return RayLauncher(experiment, timed, kind)
        case "slurm":
            from bench.run.launchers.slurm import SlurmLauncher

            return SlurmLauncher(experiment, timed, kind)
    return local_launcher(experiment, timed)
