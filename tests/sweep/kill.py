"""Kills runs at random moments and looks for what is lost: ``python tests/sweep/kill.py COUNT [SEED]``.

Each kill takes a victim (the run, a worker, the run's process group), a signal and a moment; the sweep goes on until it is
whole and then starts afresh. Counted are kills that found their victim alive. Prints one line; status 1 for any loss.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd
import psutil

from bench.studies.bias_variance.columns import COLUMNS
from bench.sweep.files import TEMPORARY
from bench.sweep.store import Store

CELLS = 60
WORDS = [
    "scenes=[heaviside,soft_heaviside]", "backends=[numpy]", "estimators=[fobg,reinforce]", "repeats=4", "samples=2048",
    "timing=false", "workers=2", "--quiet", "name=sweep", f"sweep.seed=[{','.join(map(str, range(CELLS // 4)))}]",
]  # fmt: skip
WHERE = ["stored_at", "sequence", "wall_s"]


def start(folder: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "bench", *WORDS, f"results_dir={folder}"]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True, cwd=folder
    )


def left_in(folder: Path) -> list[psutil.Process]:
    found = []
    for process in psutil.process_iter():
        try:
            if process.cwd() == str(folder) and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except psutil.Error:
            continue
    return found


def rows_of(folder: Path) -> pd.DataFrame:
    rows = Store(folder / "sweep", COLUMNS).load()
    return rows.drop(columns=WHERE).sort_values("key").reset_index(drop=True)


def main(count: int, seed: int) -> int:
    dice, faults = random.Random(seed), {"lost": 0, "changed": 0, "orphans": 0, "temporary": 0, "tracebacks": 0}
    with tempfile.TemporaryDirectory() as place:
        whole, cut = Path(place) / "whole", Path(place) / "cut"
        whole.mkdir()
        start(whole).communicate(timeout=300)
        truth, kills, rounds = rows_of(whole), 0, 0
        while kills < count:
            cut.mkdir(exist_ok=True)
            run = start(cut)
            time.sleep(dice.uniform(0.5, 4.0))
            before = rows_of(cut)
            children = psutil.Process(run.pid).children() if run.poll() is None else []
            victim = dice.choice(["run", "worker", "group"])
            sent = dice.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGSTOP])
            alive = run.poll() is None
            try:
                if victim == "run":
                    run.send_signal(sent)
                elif victim == "group":
                    os.killpg(run.pid, sent)
                elif children:
                    dice.choice(children).send_signal(sent)
            except (ProcessLookupError, psutil.Error):
                alive = False
            kills += alive
            if sent == signal.SIGSTOP and victim != "worker":
                time.sleep(0.3)
                run.kill()
            said = run.communicate(timeout=300)[1]
            faults["tracebacks"] += "Traceback" in said
            after = rows_of(cut)
            faults["lost"] += len(set(before["key"]) - set(after["key"]))
            both = truth.merge(after, on="key", suffixes=("", "_after"))
            faults["changed"] += int(
                (both["bias"] != both["bias_after"]).sum() + (both["status"] != both["status_after"]).sum()
            )
            for _ in range(100):
                if not left_in(cut):
                    break
                time.sleep(0.05)
            faults["orphans"] += len(left_in(cut))
            if len(after) == CELLS:
                rounds += 1
                start(cut).communicate(timeout=300)  # folds, and tidies what a kill has left
                faults["temporary"] += sum(bool(TEMPORARY.fullmatch(path.name)) for path in cut.rglob(".*"))
                faults["changed"] += not rows_of(cut).equals(truth)
                shutil.rmtree(cut)
        print(f"{kills} kills, {rounds} whole sweeps: {faults}")
    return 1 if any(faults.values()) else 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0))
