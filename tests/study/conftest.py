"""Studies that are served, and the browser that opens their pages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from facediff.study import StudyOptions, plan_study, read_study
from facediff.study.definition import DATABASE
from facediff.study.server import make_app
from facediff.study.store import AnswerStore
from tests.fakes.serving import servers
from tests.fakes.study import write_methods

Serve = Callable[[Path], str]


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Serves a study's folder on a free port, and gives the address without a slash at its end."""
    with servers() as running:

        def start(folder: Path) -> str:
            study = read_study(folder)
            return running.start(make_app(folder, study, AnswerStore(folder / DATABASE, study)))[0]

        yield start


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a study of two clips with two questions and comments, whose videos play."""
    root = tmp_path_factory.mktemp("study")
    folders = write_methods(root)
    truth = folders.pop("truth")
    lips = "{name: lips, text: {en: 'Whose lips?', de: 'Welche Lippen?'}, no_difference: true}"
    (root / "q.yaml").write_text(f"questions: [realism, {lips}, comments]\ntitle: <b>Faces</b> & more\n")
    options = StudyOptions(
        questions=root / "q.yaml",
        languages=["en", "de"],
        size=48,
        still_controls=1,
        same_controls=0,
        repeats=0,
        max_clips=2,
    )
    plan_study(folders, options, truth=truth).make(root / "made", workers=1, progress=False)
    return root / "made"
