"""Measure `jaxfit view`: start, memory, and how fast frames follow each other, in Chromium without a GPU.

    python tests/benchmarks/viewer.py RESULT [--video VIDEO]

Prints seconds from the command to its address and from the address to the page, the memory of the server, and the
median of frames per second of 200 steps through the film: for frames that the browser decodes for the first time, and
for frames that it has shown before.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from playwright.sync_api import sync_playwright

STEPS = 200
SOFTWARE = ["--no-sandbox", "--enable-unsafe-swiftshader", "--use-gl=angle", "--use-angle=swiftshader"]
SCRUB = """async ([first, count]) => {
  const times = [];
  for (let i = first; i < first + count; i++) {
    const start = performance.now();
    await new Promise((done) => {
      window.addEventListener("drawn", done, { once: true });
      jaxfit.go(i);
    });
    times.push(performance.now() - start);
  }
  return times;
}"""


def memory_mb(pid):
    """Return the present and the largest memory of a process, MB."""
    text = Path(f"/proc/{pid}/status").read_text()
    return [int(re.search(rf"{name}:\s+(\d+)", text)[1]) / 1024 for name in ("VmRSS", "VmHWM")]


def median_fps(times):
    return 1000 / sorted(times)[len(times) // 2]


def measure(page, address):
    """Print seconds to the page, and frames per second."""
    start = time.perf_counter()
    page.goto(address)
    while not page.evaluate("document.body.dataset.ready === 'yes'"):
        time.sleep(0.02)
    print(f"from the address to the page   {time.perf_counter() - start:6.1f} s")  # noqa: T201
    while not page.evaluate("jaxfit.state.columns[0].ledge.ready"):
        time.sleep(0.02)
    print(f"from the address to 3D         {time.perf_counter() - start:6.1f} s")  # noqa: T201
    frames = page.evaluate("jaxfit.state.frames.length")
    first = page.evaluate(SCRUB, [1, min(STEPS, frames - 1)])
    print(f"first pass, {len(first):3d} steps          {median_fps(first):6.0f} frames/s")  # noqa: T201
    again, few = [], min(50, frames - 1)  # frames that are still in the memory of the page
    page.evaluate(SCRUB, [1, few])
    while len(again) < STEPS:
        again += page.evaluate(SCRUB, [1, few])
    print(f"again,      {len(again):3d} steps          {median_fps(again):6.0f} frames/s")  # noqa: T201


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("--video", type=Path)
    options = parser.parse_args()
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        command = [str(Path(sys.executable).with_name("jaxfit")), "view", str(options.result), "--no-browser"]
        command += ["--edits", f"{folder}/edits"] + (["--video", str(options.video)] if options.video else [])
        start = time.perf_counter()
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            address = next(line.strip() for line in server.stdout if line.startswith("http"))
            print(f"from the command to the address{time.perf_counter() - start:6.1f} s")  # noqa: T201
            started = playwright.chromium.launch(executable_path=browser, args=SOFTWARE)
            measure(started.new_page(viewport={"width": 1280, "height": 720}), address)
            print("memory of the server           {:6.0f} MB, at most {:.0f} MB".format(*memory_mb(server.pid)))  # noqa: T201
            started.close()
        finally:
            server.terminate()
            server.wait()


if __name__ == "__main__":
    main()
