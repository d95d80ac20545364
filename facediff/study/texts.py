"""The words of the page, by language, and the questions of a study: bundled ones, and a user's file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from facediff.errors import FaceDiffError, check_known
from facediff.study.definition import Name, Question, Rule, Texts
from facediff.utils.plain_files import parse_json
from facediff.utils.records import read_record

PAPER_QUESTIONS = ("realism", "lip_sync", "style")
"""The questions that are asked by default; the last one needs references."""
BUNDLED = {
    "realism": Question("realism", {}),
    "lip_sync": Question("lip_sync", {}),
    "style": Question("style", {}, reference=True),
    "comments": Question("comments", {}, kind="text"),
}
"""Questions with bundled texts, under ``questions`` in ``assets/texts/*.json``."""
REMEDY = "docs/user_study.md describes files of questions"


@cache
def bundled_texts() -> dict[str, dict[str, Any]]:
    """The words of the page by language: all that ``assets/texts`` holds, English first."""
    folder = resources.files("facediff.study").joinpath("assets", "texts")
    by_language = {
        entry.name.removesuffix(".json"): parse_json(entry.read_bytes(), entry.name)
        for entry in folder.iterdir()
        if entry.name.endswith(".json")
    }
    return dict(sorted(by_language.items(), key=lambda item: (item[0] != "en", item[0])))


def check_languages(languages: Sequence[str] | None) -> list[str]:
    """The languages of a study; all bundled ones if None."""
    bundled = bundled_texts()
    check_known("--languages", "language", languages or (), bundled)
    return list(languages or bundled)


def standard(name: str, languages: Sequence[str]) -> dict[str, str]:
    """A bundled text that a file may replace: ``title`` or ``consent``."""
    return {language: bundled_texts()[language][name] for language in languages}


def bundled_question(name: str, languages: Sequence[str]) -> Question:
    """A question with a bundled text."""
    question = BUNDLED[name]
    text = {language: bundled_texts()[language]["questions"][name] for language in languages}
    return Question(name, text, question.kind, question.reference, question.no_difference)


@dataclass(frozen=True)
class QuestionEntry:
    """A question of a file: the name of a bundled one, or one of the user's; see :class:`Question`."""

    name: Name
    text: Any = None
    kind: Literal["choice", "text"] | None = None
    reference: bool | None = None
    no_difference: bool | None = None


@dataclass(frozen=True)
class QuestionFile:
    """A file of questions; texts are one for all languages, or one by language."""

    questions: tuple[Any, ...] | None = None
    title: Any = None
    consent: Any = None
    rule: Rule = Rule()


class Questionnaire:
    """Questions, title, consent and rule of a study, from defaults and from a file of the user's.

    Args:
        path: a YAML file with ``questions``, ``title``, ``consent`` and ``rule``, each of which may be missing; None
            for the paper's questions and a field for comments.

    Attributes:
        named: whether the file names the questions, so that none may be left out for lack of references.
    """

    def __init__(self, path: Path | None, languages: Sequence[str]) -> None:
        from facediff.utils.yaml_files import load_yaml

        self.languages, self.source = languages, path
        content = read_record(QuestionFile, {} if path is None else load_yaml(path, REMEDY), path, remedy=REMEDY)
        self.title = self._texts(content.title, "title", standard("title", languages))
        self.consent = self._texts(content.consent, "consent", standard("consent", languages))
        self.rule = content.rule
        self.named = content.questions is not None
        entries = (*PAPER_QUESTIONS, "comments") if content.questions is None else content.questions
        self.questions = [self._question(entry, f"questions[{i}]") for i, entry in enumerate(entries)]
        names = [question.name for question in self.questions]
        if len({*names}) < len(names) or not any(question.kind == "choice" for question in self.questions):
            raise FaceDiffError(f"{path}: questions are {', '.join(names)}; expected each once, and a choice; {REMEDY}")

    def _question(self, content: object, key: str) -> Question:
        content = {"name": content} if isinstance(content, str) else content
        entry = read_record(QuestionEntry, content, self.source, remedy=REMEDY, name=key)
        bundled = bundled_question(entry.name, self.languages) if entry.name in BUNDLED else Question(entry.name, {})
        return Question(
            entry.name,
            self._texts(entry.text, f"{key}.text", bundled.text),
            entry.kind or bundled.kind,
            bundled.reference if entry.reference is None else entry.reference,
            bundled.no_difference if entry.no_difference is None else entry.no_difference,
        )

    def _texts(self, content: Any, key: str, default: Texts) -> Texts:  # noqa: ANN401 - a text or a mapping
        """A text for every language: one for all, or one by language."""
        texts = dict.fromkeys(self.languages, content) if isinstance(content, str) else content or default
        complete: dict[str, Any] = {
            name: texts.get(name) if isinstance(texts, dict) else None for name in self.languages
        }
        for language, text in complete.items():
            if not isinstance(text, str) or not text.strip():
                raise FaceDiffError(
                    f"{self.source}: {key} has no text in {language}; add one, choose --languages without it, or name "
                    f"one of the bundled questions: {', '.join(BUNDLED)}"
                )
        return complete


def page_texts(languages: Sequence[str]) -> Mapping[str, Mapping[str, str]]:
    """The words of the page's buttons and hints, by language."""
    replaced = ("title", "consent", "questions")
    return {
        language: {name: text for name, text in bundled_texts()[language].items() if name not in replaced}
        for language in languages
    }
