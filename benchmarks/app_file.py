"""A data file of 200 MB on the page of `orthaug app`, from the drop to the export: time, and memory of its processes.

Run: python benchmarks/app_file.py (needs Linux, Playwright and Chromium)
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from machine import describe
from playwright.sync_api import sync_playwright
from scipy.signal import lfilter

ROWS, HELD, BLOCK = 4_200_000, 20, 100_000
CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium")
LATE = 600_000  # ms
SERVER = "from orthaug.commands.entry import main; main()"


def write(path: Path) -> None:
    """Time, a held random input, and the output of a damped system with noise."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1, 1, ROWS // HELD), HELD)
    y = lfilter([0, 0.5], [1, -0.6, 0.2], u) + 0.01 * rng.normal(size=ROWS)
    with path.open("w", encoding="utf-8") as file:
        file.write("time [s],u,y [m]\n")
        for a in range(0, ROWS, BLOCK):
            file.write(
                "".join(f"{k / 1000:.3f},{u[k]:.16f},{y[k]:.16f}\n" for k in range(a, a + BLOCK))
            )


class Watched(threading.Thread):
    """The most memory that a process and those below it have held, by process [bytes]."""

    def __init__(self, process: int) -> None:
        super().__init__(daemon=True)
        self.process, self.most, self.ending = process, {}, False

    def run(self) -> None:
        while not self.ending:
            for number in (self.process, *below(self.process)):
                try:
                    status = Path(f"/proc/{number}/status").read_text(encoding="utf-8")
                except OSError:
                    continue
                found = re.search(r"VmHWM:\s+(\d+) kB", status)
                self.most[number] = 1024 * int(found[1]) if found else self.most.get(number, 0)
            time.sleep(0.05)


def below(process: int) -> list[int]:
    """The processes that one has started."""
    tasks = Path(f"/proc/{process}/task").glob("*/children")
    return [int(number) for task in tasks for number in task.read_text(encoding="utf-8").split()]


def main() -> None:
    print(describe())
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "run.csv"
        write(file)
        program = [sys.executable, "-c", SERVER, "app", "--no-browser"]
        server = subprocess.Popen(program, stdout=subprocess.PIPE, text=True)
        url = server.stdout.readline().strip()  # type: ignore[union-attr]
        watched = Watched(server.pid)
        watched.start()
        try:
            with sync_playwright() as playing:
                tab = playing.chromium.launch(
                    executable_path=CHROMIUM, args=["--no-sandbox"]
                ).new_page()
                tab.set_default_timeout(LATE)
                tab.goto(url)
                tab.wait_for_selector("#drop")
                time.sleep(1)
                before, began = watched.most[server.pid], time.perf_counter()
                tab.set_input_files("#dropped", file)
                found = {}
                for what, seen in (
                    ("taken in", "text=run.csv is here"),
                    ("looked at", ".account"),
                    ("checked", ".parts table"),
                ):
                    tab.wait_for_selector(seen)
                    found[what] = time.perf_counter() - began
                for part, press, what, seen in (
                    ("Training", "Train", "trained", "text=Training is done"),
                    ("Report", None, "its report open", "iframe"),
                    ("Export", "Write c", "written in C", "text=c.zip"),
                ):
                    tab.get_by_role("tab", name=part).click()
                    if press:
                        tab.get_by_role("button", name=press, exact=True).click()
                    tab.wait_for_selector(seen)
                    found[what] = time.perf_counter() - began
        finally:
            watched.ending = True
            server.send_signal(signal.SIGINT)
            server.wait(20)
        helpers = max(most for number, most in watched.most.items() if number != server.pid)
        print(
            f"{file.stat().st_size / 1e6:.0f} MB, {ROWS} rows: "
            + ", ".join(f"{w} {t:.1f} s" for w, t in found.items())
        )
        print(
            f"server {before / 1e6:.0f} MB before, at most "
            f"{watched.most[server.pid] / 1e6:.0f} MB; ",
            end="",
        )
        print(f"largest process that looks at data or trains {helpers / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
