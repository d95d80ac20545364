"""``python -m facediff.benchmark.exit_with_parent MODULE WORDS``: runs a module that ends with its parent.

Standard input is a pipe of which the parent holds the other end. When the parent ends, however it ends, the pipe breaks
and this process is killed: nothing goes on writing into a folder that the parent's successor is about to use. Files
appear whole or not at all, so that no half-written one is left.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading


def end_with_parent() -> None:
    """Kill this process when standard input ends."""
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))


def main() -> None:
    """Run the module that the first word names, with the other words as its own."""
    threading.Thread(target=end_with_parent, daemon=True).start()
    sys.argv = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
