import json
from pathlib import Path
from typing import Any

import pytest

from tests.fakes.processes import run

SCRIPT = Path(__file__).parents[2] / "tools" / "benchmarks" / "sampling.py"
TOY = "--vertices 30 --seconds 1 --dim 32 --layers 2 --threads 1 --repeats 2 --full 3 --tiny-encoder"

Output = tuple[str, dict[str, Any]]


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Output:
    """What a toy run prints, and its unrounded numbers."""
    numbers = tmp_path_factory.mktemp("sampling") / "numbers.json"
    done = run(SCRIPT, *TOY.split(), "--json", numbers)
    assert done.returncode == 0, done.stderr
    return done.stdout, json.loads(numbers.read_text())


def test_every_total_is_the_sum_of_its_parts(output: Output) -> None:
    _, numbers = output
    assert numbers["seconds"] == 1.0
    assert len(numbers["rows"]) == 12
    for row in numbers["rows"]:
        parts = row["audio_encoder"] + row["conditions"] + row["steps"] * row["per_step"] + row["rest"]
        assert row["total"] == pytest.approx(parts)
        assert row["real_time_factor"] == pytest.approx(row["total"] / numbers["seconds"])
        assert row["per_step"] == numbers["costs"]["step"][row["space"]][row["sampler"]]


def test_the_ratios_follow_from_the_parts(output: Output) -> None:
    _, numbers = output
    costs, ratios = numbers["costs"], numbers["ratios"]
    assert ratios["step"] == pytest.approx(costs["step"]["vertices"]["ddpm"] / costs["step"]["folded"]["ddpm"])
    peer = costs["conditions"] + 500 * (costs["audio_encoder"] + costs["step"]["vertices"]["ddpm"])
    usual = next(r for r in numbers["rows"] if (r["space"], r["sampler"], r["steps"]) == ("folded", "ddim", 25))
    assert ratios["peer_to_ddim_25"] == pytest.approx(peer / usual["total"])
    # A step costs the same whatever the number of steps; the default sampler ran with three.
    full = numbers["full"]
    by_default = next(r for r in numbers["rows"] if (r["space"], r["sampler"]) == ("folded", full["sampler"]))
    shorter = by_default["total"] - (by_default["steps"] - full["steps"]) * by_default["per_step"]
    assert ratios["peer_to_default"] == pytest.approx(peer / shorter)
    assert ratios["vertices_5023"] > 0
    student = numbers["student"]
    assert student["peer"] == pytest.approx(peer / student["measured"])
    assert student["real_time_factor"] == pytest.approx(student["measured"] / numbers["seconds"])


def test_the_printed_table_holds_the_same_numbers(output: Output) -> None:
    text, numbers = output
    lines = text.split("a clip, in seconds", 1)[1].splitlines()[2:14]
    for line, row in zip(lines, numbers["rows"], strict=True):
        space, name, steps, *cells = line.split()
        assert (space, name, int(steps)) == (row["space"], row["sampler"], row["steps"])
        audio, conditions, all_steps, rest, total, factor = map(float, cells)
        assert total == pytest.approx(audio + conditions + all_steps + rest, abs=3e-4)
        assert total == pytest.approx(row["total"], abs=1e-4)
        assert factor == pytest.approx(row["real_time_factor"], abs=1e-4)


def test_machine_memory_and_the_full_run_are_named(output: Output) -> None:
    text, numbers = output
    assert "machine: " in text
    assert "device cpu" in text
    assert "EXTRAPOLATED" in text
    assert "peak memory of that: " in text
    assert f"{numbers['full']['sampler']} 3, folded, in full: " in text
    assert numbers["full"]["steps"] == 3
    assert numbers["full"]["measured"] > 0
