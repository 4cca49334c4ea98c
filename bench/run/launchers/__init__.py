"""Launchers, which run tasks here or on a cluster. All produce the same rows, and can resume each other's sweeps.

Another launcher is a class with the methods of :class:`~bench.run.launchers.launcher.Launcher`, a case of
:func:`launcher_of`, a name in ``LAUNCHERS`` of :mod:`bench.experiment.config`, and its settings in ``conf/config.yaml`` and
``TABLES`` of :mod:`bench.experiment.overrides`.
"""

from __future__ import annotations

from bench.experiment.experiment import Experiment
from bench.run.launchers.launcher import Launcher, local_launcher


def launcher_of(experiment: Experiment, timed: bool = False, kind: str = "") -> Launcher:
    """Return the experiment's launcher.

    Timed tasks run one at a time on an otherwise unused machine, and all machines are of the given ``kind`` or, if it is
    empty, of the first machine's kind. Other tasks run in parallel, each on one thread.
    """
    if experiment.execution.launcher == "ray":
        from bench.run.launchers.ray import RayLauncher

        return RayLauncher(experiment, timed, kind)
    return local_launcher(experiment, timed)
