"""Stands in for ``facediff fit`` and ``facediff test`` where a test is about what runs them: no torch, no training.

A program, ``python -m tests.fakes.stand_in fit …``. Every call is noted in the file ``$STAND_IN_CALLS``, with its
process; ``trainer.fail`` makes it fail; with ``$STAND_IN_WAITS`` a training never ends.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path


def main() -> None:
    """Do as if."""
    command, *words = sys.argv[1:]
    options = dict(word.removeprefix("--").split("=", 1) for word in words if "=" in word)
    checkpoint = words[words.index("--ckpt_path") + 1] if "--ckpt_path" in words else None
    place = Path(options["trainer.logger.save_dir"], options["trainer.logger.name"], "version_0")
    with open(os.environ["STAND_IN_CALLS"], "a", encoding="utf-8") as calls:
        facts = {"command": command, "name": place.parent.name, "pid": os.getpid(), "continues": checkpoint is not None}
        calls.write(json.dumps(facts | options) + "\n")
    if options.get("trainer.fail") == command:
        print("some line\nfacediff: error: model.dim 0: made to fail", file=sys.stderr)
        raise SystemExit(2)
    place.mkdir(parents=True, exist_ok=True)
    if command == "fit":
        last = place / "checkpoints" / "last.ckpt"
        last.parent.mkdir(exist_ok=True)
        if options.get("trainer.enable_checkpointing") == "false":
            return
        last.write_text(json.dumps({"seed": options["seed_everything"], "dim": options.get("model.dim", "0")}))
        if "STAND_IN_WAITS" in os.environ:
            time.sleep(600)
        return
    assert checkpoint is not None
    made = json.loads(Path(checkpoint).read_text())
    rows = [
        {"split": "test_a", "method": "model", "clip": f"A_e{n:02d}", "identity": "", "frames": 10 + n}
        | {"lve": (1 + int(made["dim"])) * (n + 1.0) + 0.01 * int(made["seed"])}
        for n in range(6)
    ]
    lve = sum(row["lve"] * row["frames"] for row in rows) / sum(row["frames"] for row in rows)
    counts = {"frames": sum(row["frames"] for row in rows), "sequences": len(rows)}
    report = {
        "provenance": {"model": "StandIn", "seed": int(made["seed"]), "corpus": "tiny", "manifest": "none"},
        "synthetic": True,
        "definition": f"protocol {options['model.protocol']}",
        "columns": {"lve": {"pooling": "frames", "better": "lower"}},
        "scores": [{"split": "test_a", "method": "model", "protocol": options["model.protocol"], "lve": lve, **counts}],
        "sequences": rows,
    }
    (place / "test_report.json").write_text(json.dumps(report))


if __name__ == "__main__":
    main()
