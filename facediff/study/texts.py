"""The words of the page, by language, and the questions of a study: bundled ones, and those of a file of the user's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from facediff.errors import FaceDiffError, choices
from facediff.study.definition import LANGUAGE, LONGEST_TEXT, NAME, Question, Rule, Texts, make_rule
from facediff.utils.limits import quoted
from facediff.utils.plain_files import parse_json

PAPER_QUESTIONS = ("realism", "lip_sync", "style")
"""The questions that are asked by default; the last one needs references."""
BUNDLED = {
    "realism": Question("realism", {}),
    "lip_sync": Question("lip_sync", {}),
    "style": Question("style", {}, reference=True),
    "comments": Question("comments", {}, kind="text"),
}
"""Questions whose texts are bundled, under ``questions`` in ``assets/texts/*.json``."""
REMEDY = "see docs/user_study.md for what a file of questions holds"
MOST_QUESTIONS = 20


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
    for language in languages or ():
        if language not in bundled:
            raise FaceDiffError(f'--languages: there are no texts in "{language}": {choices(language, bundled)}')
    return list(languages or bundled)


def standard(name: str, languages: Sequence[str]) -> dict[str, str]:
    """A bundled text that a file may replace: ``title`` or ``consent``."""
    return {language: bundled_texts()[language][name] for language in languages}


def bundled_question(name: str, languages: Sequence[str]) -> Question:
    """A question whose text is bundled."""
    if name not in BUNDLED:
        raise FaceDiffError(f'there is no bundled question "{name}": {choices(name, BUNDLED)}')
    question = BUNDLED[name]
    text = {language: bundled_texts()[language]["questions"][name] for language in languages}
    return Question(name, text, question.kind, question.reference, question.no_difference)


class Questionnaire:
    """Questions, title, consent and rule of a study, from defaults and from a file of the user's.

    Args:
        path: a YAML file with ``questions``, ``title``, ``consent`` and ``rule``, each of which may be missing; None
            for the paper's questions and a field for comments.
        languages: of the page.

    Attributes:
        questions: what is asked, in order.
        title: shown above everything.
        consent: what raters agree to.
        rule: whose answers are not counted.
        chosen: whether the file names the questions, so that none may be left out for lack of references.
    """

    def __init__(self, path: Path | None, languages: Sequence[str]) -> None:
        self.languages = languages
        self.source: object = path
        content: dict[str, Any] = {}
        if path is not None:
            from facediff.utils.yaml_files import load_yaml

            content = load_yaml(path, REMEDY)
        for key in content:
            if key not in ("questions", "title", "consent", "rule"):
                advice = choices(key, ("questions", "title", "consent", "rule"))
                raise FaceDiffError(f'{path}: has the unknown field "{key}": {advice}')
        self.title = self._texts(content.get("title"), "title", standard("title", languages))
        self.consent = self._texts(content.get("consent"), "consent", standard("consent", languages))
        self.rule: Rule = make_rule(content.get("rule"), path)
        listed = content.get("questions")
        self.chosen = listed is not None
        if listed is None:
            listed = [*PAPER_QUESTIONS, "comments"]
        if not isinstance(listed, list) or not 1 <= len(listed) <= MOST_QUESTIONS:
            raise FaceDiffError(f"{path}: questions are no list of 1 to {MOST_QUESTIONS}; {REMEDY}")
        self.questions = [self._question(entry, f"questions[{i}]") for i, entry in enumerate(listed)]
        names = [question.name for question in self.questions]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise FaceDiffError(f'{path}: there are two questions "{twice}"; rename one')
        if not any(question.kind == "choice" for question in self.questions):
            raise FaceDiffError(f"{path}: questions ask for no choice between two videos; {REMEDY}")

    def _question(self, content: object, place: str) -> Question:
        if isinstance(content, str):
            try:
                return bundled_question(content, self.languages)
            except FaceDiffError as error:
                raise FaceDiffError(f"{self.source}: {place}: {error}") from error
        if not isinstance(content, dict):
            raise FaceDiffError(f"{self.source}: {place} is {quoted(content)}; {REMEDY}")
        keys = ("name", "text", "kind", "reference", "no_difference")
        wrong = next((key for key in content if key not in keys), None)
        if wrong is not None:
            raise FaceDiffError(f"{self.source}: {place} has the unknown field {quoted(wrong)}: {choices('', keys)}")
        name = content.get("name")
        if not isinstance(name, str) or not NAME.fullmatch(name):
            raise FaceDiffError(
                f"{self.source}: {place}.name is {quoted(name)}; expected small letters, digits and underscores"
            )
        flags = {}
        for flag in ("reference", "no_difference"):
            value = content.get(flag, getattr(BUNDLED.get(name), flag, False))
            if not isinstance(value, bool):
                raise FaceDiffError(f"{self.source}: {place}.{flag} is {quoted(value)}; expected true or false")
            flags[flag] = value
        kind = content.get("kind", BUNDLED[name].kind if name in BUNDLED else "choice")
        if kind not in ("choice", "text"):
            raise FaceDiffError(f"{self.source}: {place}.kind is {quoted(kind)}; expected choice or text")
        if kind == "text" and any(flags.values()):
            raise FaceDiffError(f"{self.source}: {place}: a text has no reference and no third answer; omit them")
        standard_text = bundled_question(name, self.languages).text if name in BUNDLED else None
        return Question(name, self._texts(content.get("text"), f"{place}.text", standard_text), kind, **flags)

    def _texts(self, content: object, place: str, default: Texts | None) -> dict[str, str]:
        """A text for every language: one for all, or one by language."""
        if content is None and default is not None:
            return dict(default)
        texts = dict.fromkeys(self.languages, content) if isinstance(content, str) else content
        if not isinstance(texts, dict):
            raise FaceDiffError(f"{self.source}: {place} is {quoted(content)}; expected a text, or one by language")
        for language in texts:
            if not isinstance(language, str) or not LANGUAGE.fullmatch(language):
                raise FaceDiffError(f"{self.source}: {place} has the language {quoted(language)}; expected en, de …")
        for language in self.languages:
            text = texts.get(language)
            if not isinstance(text, str) or not text.strip() or len(text) > LONGEST_TEXT:
                raise FaceDiffError(
                    f"{self.source}: {place} has no text in {language}; add one, or choose --languages without it"
                )
        return {language: str(texts[language]) for language in self.languages}


def page_texts(languages: Sequence[str]) -> Mapping[str, Mapping[str, str]]:
    """The words of the page's buttons and hints, by language."""
    kept = ("title", "consent", "questions")
    return {
        language: {name: text for name, text in bundled_texts()[language].items() if name not in kept}
        for language in languages
    }
