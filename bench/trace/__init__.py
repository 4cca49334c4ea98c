"""``python -m bench trace``: one rollout step by step, and whether its gradient spikes line up with contact switches."""

from bench.trace.chart import write
from bench.trace.trace import Trace, run

__all__ = ["Trace", "run", "write"]
