"""Takes the picture of the live view.

A viewer in headless Chromium, connected to a running ``gpmpc run live=true``.

    python docs/live_view.py [--out docs/figures/live.png] [--tab Solver] [--steps 40]

The viewer is the last open release of Foxglove Studio on npm (1.48, MPL-2.0), the
application that Lichtblick goes on with; Lichtblick itself is not on npm. The packages
are installed into ``outputs/live_view`` and are no part of the repository. The picture
is taken by Chromium (``--screenshot``) when the page has loaded, and the page has
loaded when the server of this script has answered for its last picture: after the given
number of steps.
"""

import argparse
import functools
import json
import re
import shutil
import subprocess
import sys
import threading
import time
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

HERE = Path(__file__).resolve().parent
PACKAGES = ("@foxglove/studio-base@1.48.0", "react@17.0.2", "react-dom@17.0.2")
SIZE = (1500, 900)  # [px]
PATIENCE = 300  # [s] for a browser that draws in software
TABS = ("Position", "Rates", "Inputs", "Uncertainty", "Solver")  # of the layout


class Site(SimpleHTTPRequestHandler):
    """Serves the page and its parts, and takes down what the page shows."""

    def do_GET(self):
        """Answers with a file; ``/until`` only when the picture is to be taken."""
        path = self.path.partition("?")[0]
        if path == "/until":
            self.server.due.wait()
            return self._answer(b"", "image/png")
        if path == "/":
            return self._answer((HERE / "live_view.html").read_bytes(), "text/html")
        if path == "/layout":
            return self._answer(self.server.layout, "application/json")
        if path.endswith(
            "/assets/index.js"
        ):  # of 2023, when the protocol had another name; its messages stayed
            text = Path(self.translate_path(path)).read_bytes()
            return self._answer(
                text.replace(b"foxglove.websocket.v1", b"foxglove.sdk.v1"),
                "text/javascript",
            )
        return super().do_GET()

    def do_POST(self):
        """Keeps the text that the page shows."""
        self.server.seen = json.loads(
            self.rfile.read(int(self.headers["Content-Length"]))
        )
        self._answer(b"", "text/plain")

    def _answer(self, content, kind):
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_):
        """Prints nothing."""


def main():
    """Installs the viewer, flies, and writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=HERE / "figures" / "live.png")
    parser.add_argument(
        "--folder", type=Path, default=HERE.parent / "outputs" / "live_view"
    )
    parser.add_argument("--tab", choices=TABS, default=TABS[0], help="of the layout")
    parser.add_argument(
        "--steps",
        type=int,
        default=40,
        help="that the viewer has received before the picture",
    )
    options = parser.parse_args()
    chromium = (
        shutil.which("chromium")
        or shutil.which("google-chrome")
        or sys.exit("needs chromium")
    )
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "node_modules").exists():
        subprocess.run(
            [
                "npm",
                "install",
                "--silent",
                "--prefix",
                folder,
                "--ignore-scripts",
                *PACKAGES,
            ],
            check=True,
        )
    layout = json.loads((HERE / "foxglove-layout.json").read_text())
    layout["configById"]["Tab!plots"]["activeTabIdx"] = TABS.index(options.tab)

    server = ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Site, directory=folder / "node_modules")
    )
    server.due, server.seen, server.layout = (
        threading.Event(),
        {},
        json.dumps(layout).encode(),
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    command = [
        "run",
        "live=true",
        "trajectory=lorenz",
        "steps=200",
        "data.size=40",
        f"folder={folder / 'runs'}",
    ]
    program = [sys.executable, "-c", "from gpmpc.cli import main; main()", *command]
    with subprocess.Popen(
        program, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    ) as flight:
        try:
            address = next(
                found[0]
                for line in flight.stderr
                if (found := re.search(r"ws://[\d.:]+", line))
            )
            threading.Thread(target=flight.stderr.read, daemon=True).start()
            url = f"http://127.0.0.1:{server.server_port}/?address={address}"
            flags = [
                "--headless=new",
                "--no-sandbox",
                "--hide-scrollbars",
                "--enable-unsafe-swiftshader",
            ]
            flags += [
                "--use-angle=swiftshader",
                f"--window-size={SIZE[0]},{SIZE[1]}",
                f"--user-data-dir={folder}/profile",
            ]
            browser = subprocess.Popen(
                [chromium, *flags, f"--screenshot={options.out.resolve()}", url],
                stderr=subprocess.DEVNULL,
            )
            deadline = time.monotonic() + PATIENCE
            while (
                steps := received(server.seen)
            ) < options.steps and time.monotonic() < deadline:
                time.sleep(1)
            server.due.set()
            browser.wait(60)
        finally:
            flight.terminate()
    if steps < options.steps or server.seen["failures"]:
        sys.exit(f"the viewer received {steps} steps, and shows: {server.seen}")
    kilobytes = options.out.stat().st_size / 1e3
    print(f"{options.out}: {steps} steps received, {kilobytes:.0f} kB")


def received(seen):
    """The messages of /step that the viewer says it has counted."""
    found = re.search(r"gpmpc\.Step\s+(\d+)", seen.get("text", ""))
    return int(found[1]) if found else 0


if __name__ == "__main__":
    main()
