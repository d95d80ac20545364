"""The page that raters get: one HTML file next to its videos, which runs from a folder or from ``study serve``."""

from __future__ import annotations

import html
from importlib import resources
from pathlib import Path

from facediff.study.answers import FORMAT, LONGEST_COMMENT
from facediff.study.definition import Study
from facediff.study.texts import page_texts
from facediff.utils.files import atomic
from facediff.utils.html_pages import fill, hash_source, script_data

PAGE = "index.html"


def write_page(folder: Path, study: Study) -> None:
    """Write ``index.html`` into the page's folder, which has the videos in ``videos``."""
    with atomic(folder / PAGE) as temporary:
        temporary.write_text(page_of(study), encoding="utf-8", newline="\n")


def page_of(study: Study) -> str:
    """The page's text. It names no method and does not mark controls."""
    style, script = _asset("style.css"), _asset("study.js")
    first = study.languages[0]
    facts = {
        "id": study.id,
        "answers": FORMAT,
        "longest": LONGEST_COMMENT,
        "languages": list(study.languages),
        "texts": page_texts(study.languages),
        "title": dict(study.title),
        "consent": dict(study.consent),
        "remark": study.remark,
        "questions": [
            {
                "name": question.name,
                "text": dict(question.text),
                "kind": question.kind,
                "reference": question.reference,
                "answers": list(question.answers),
            }
            for question in study.questions
        ],
        "trials": [{"id": trial.id, "video": trial.video, "reference": trial.reference} for trial in study.trials],
        "schedules": [list(row) for row in study.schedules],
    }
    # Lets this script and this style run, and nothing be loaded but the videos. "self" means nothing to a page that is
    # a file, hence the scheme.
    policy = (
        f"default-src 'none'; script-src {hash_source(script)}; style-src {hash_source(style)}; "
        f"media-src 'self' file:; connect-src 'self'; base-uri 'none'; form-action 'none'"
    )
    values = {
        "title": html.escape(study.title[first]),
        "policy": policy,
        "style": style,
        "study": script_data(facts),
        "script": script,
    }
    return fill(_asset("page.html"), values)


def _asset(name: str) -> str:
    return resources.files("facediff.study").joinpath("assets", name).read_text(encoding="utf-8")
