"""Hooks of MkDocs: what the site has in addition to the pages of docs/, which stay as a code host shows them.

- The navigation is the index, docs/README.md: every heading with a table below it is a section, every link in the
  table's first column a page. A page that the index omits fails the strict build.
- Links that leave docs/ lead to files of the repository. Such a file becomes a page of the site if it is Markdown, and
  is copied otherwise; a link to nothing fails the strict build.
- A notebook becomes a page with its text and code, and is offered as it is.
- The API reference has a page per module that mkdocs.yml lists, made from docstrings of the names that it exports.
- Search works in pages that were opened as files, where browsers start no web workers: `iframe_worker.js`.
- The bundled model talks on a page of its own, as `facediff serve -o` writes it; the home page links to it. Where ONNX
  Runtime for browsers cannot be fetched, the site has neither.
- What a strict build of MkDocs does not notice fails it too: `checks.py`.
"""

from __future__ import annotations

import json
import posixpath
import re
import sys
from functools import cache
from pathlib import Path
from typing import Any

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import get_plugin_logger
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE))

import checks  # noqa: E402 - a neighbour of this file, which MkDocs loads by its path

log = get_plugin_logger("facediff")

LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#|/)([^)\s#]+)(#[^)\s]*)?(?=\))")

ELSEWHERE = "project"
"""Folder of the site with the files of the repository that are not in docs/."""

TALKING = "talk"
"""Folder of the site with the page on which the bundled model talks."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The navigation, from the index and the list of modules."""
    index = Path(config.docs_dir, "README.md").read_text(encoding="utf-8")
    nav: list[Any] = [{"Home": "README.md"}]
    for title, section in re.findall(r"^## (.+)\n((?:(?!## ).*\n?)*)", index, re.MULTILINE):
        cells = re.findall(r"^\| (.*?) \|", section, re.MULTILINE)
        links = [link for cell in cells for link in re.findall(r"\[([^]]+)\]\(([^)#]+)\)", cell)]
        # A link that is called like its file has the page's own title in the navigation.
        pages = [where if text == where else {text: where} for text, to in links for where in [site_path("docs", to)]]
        if pages:
            nav.append({title: pages})
    modules = [{name.removeprefix("facediff."): f"api/{name}.md"} for name in config.extra["api"]]
    nav.append({"API reference": ["api/README.md", *modules]})
    config.nav = nav
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the API reference, the files of the repository that pages link to, and the worker of the search."""
    for name in config.extra["api"]:
        files.append(File.generated(config, f"api/{name}.md", content=api_page(name)))
    for file in [file for file in files if file.src_uri.endswith(".ipynb")]:
        files.append(File.generated(config, site_path("docs", file.src_uri), content=notebook_page(file)))
    files.append(File.generated(config, "api/README.md", content=api_index(config.extra["api"])))
    files.append(File.generated(config, "assets/iframe-worker.js", abs_src_path=str(HERE / "iframe_worker.js")))
    files.append(File.generated(config, "assets/site.css", abs_src_path=str(HERE / "site.css")))
    for name, content in talking_site().items():
        source = {"content": content} if isinstance(content, bytes) else {"abs_src_path": str(content)}
        files.append(File.generated(config, name, inclusion=InclusionLevel.NOT_IN_NAV, **source))
    waiting = [file for file in files.documentation_pages() if file.abs_src_path]
    while waiting:
        file = waiting.pop()
        source = Path(str(file.abs_src_path)).relative_to(ROOT)
        for link, _ in LINK.findall(Path(str(file.abs_src_path)).read_text(encoding="utf-8")):
            target = ROOT / posixpath.normpath(source.parent / link)
            where = site_path(source.parent.as_posix(), link)
            if where.startswith(f"{ELSEWHERE}/") and target.is_file() and where not in files.src_uris:
                added = File.generated(config, where, abs_src_path=str(target), inclusion=InclusionLevel.NOT_IN_NAV)
                files.append(added)
                waiting += [added] * added.is_documentation_page()
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:  # noqa: ANN401
    """Links to files of the repository become links to where the site has them."""
    if not page.file.abs_src_path:
        return markdown
    if page.file.src_uri == "README.md" and talking_site():
        markdown = markdown.replace(
            "\n", f"\n\n[Try it]({TALKING}/index.html): a face that says what you say, in this browser.\n", 1
        )
    folder = Path(page.file.abs_src_path).relative_to(ROOT).parent.as_posix()
    here = posixpath.dirname(page.file.src_uri)

    def moved(link: re.Match[str]) -> str:
        where = site_path(folder, link[1])
        inside = not where.startswith(f"{ELSEWHERE}/") and not here.startswith(ELSEWHERE)
        if inside and not link[1].endswith(".ipynb"):
            return link[0]
        return posixpath.relpath(where, here or ".") + (link[2] or "")

    return LINK.sub(moved, markdown)


def on_post_build(config: MkDocsConfig) -> None:
    """Links in raw HTML, and whatever a page would fetch from elsewhere, are reported."""
    for problem in checks.broken(Path(config.site_dir)):
        log.warning("%s", problem)


@cache
def talking_site() -> dict[str, bytes | Path]:
    """The files of the page on which the bundled model talks, by their paths in the site."""
    from facediff.errors import FaceDiffError
    from facediff.runtime.onnxruntime_web import web_runtime
    from facediff.runtime.site import headers_file, make_site
    from facediff.utils.hub import BUNDLED

    try:
        runtime = web_runtime(say=log.info)
    except FaceDiffError as error:
        log.info("no talking page: %s", error)
        return {}
    site = make_site(BUNDLED, runtime, sorted((ROOT / "docs" / "examples").glob("*.wav")))
    # Hosts of static files read headers at the root of a site only.
    headers = {"_headers": headers_file(f"/{TALKING}/*").encode()}
    return {f"{TALKING}/{name}": content for name, content in site.items() if name not in headers} | headers


def site_path(folder: str, link: str) -> str:
    """Where the site has what a page in a folder of the repository links to."""
    target = posixpath.normpath(posixpath.join(folder, link))
    if target.startswith("docs/"):
        return re.sub(r"\.ipynb$", ".md", target.removeprefix("docs/"))
    return f"{ELSEWHERE}/{target.lstrip('.')}"  # servers and MkDocs leave out names that begin with a dot


def notebook_page(file: File) -> str:
    """A notebook's text, code and printed outputs as Markdown, with a link to the notebook itself."""
    parts = []
    for cell in json.loads(file.content_string)["cells"]:
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else text.replace(".ipynb)", ".md)"))
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            shown = "".join(output.get("text") or data.get("text/plain", "")).rstrip()
            if picture := data.get("image/png"):
                parts.append(f"![output](data:image/png;base64,{''.join(picture).replace(chr(10), '')})")
            elif shown:
                parts.append(f"```text\n{shown}\n```")
    title, _, rest = parts[0].partition("\n")
    parts[0] = f"{title}\n\n[The notebook]({file.name}.ipynb), to be run in Jupyter.\n{rest}"
    return "\n\n".join(parts) + "\n"


def public_names(module: griffe.Module) -> list[str]:
    """The names that a module offers: its ``__all__``, else what it imports ``as`` itself, else what it defines."""
    if module.exports:
        return [str(name) for name in module.exports]
    if module.is_init_module:
        imported = [name for name, member in module.members.items() if member.is_alias]
        own = [name for name in imported if module[name].target_path.startswith("facediff.") and name != "lazy_names"]
        if own:
            return own
    return [
        name
        for name, member in module.members.items()
        if not member.is_alias and not member.is_module and not name.startswith("_") and member.has_docstring
    ]


@cache
def loaded() -> griffe.Module:
    """The package as its source text, not imported."""
    module = griffe.load("facediff", search_paths=[str(ROOT)])
    assert isinstance(module, griffe.Module)
    return module


def module_of(package: griffe.Module, name: str) -> Any:  # noqa: ANN401 - griffe's own type for what it finds
    """The module of a package by its whole name, such as ``facediff.models``."""
    return package if name == package.name else package[name.partition(".")[2]]


def api_page(name: str) -> str:
    """A page of the reference: the module's docstring, then each of its public names."""
    package = module_of(loaded(), name)
    parts = [
        f"# {name}",
        f"::: {name}\n    options: {{members: false, show_root_heading: false, show_root_toc_entry: false}}",
    ]
    parts += [f"::: {name}.{thing}" for thing in public_names(package)]
    return "\n\n".join(parts) + "\n"


def api_index(names: list[str]) -> str:
    """The page that lists the modules of the reference."""
    package = loaded()
    rows = []
    for name in names:
        module = module_of(package, name)
        summary = module.docstring.value.partition("\n\n")[0].replace("\n", " ") if module.docstring else ""
        rows.append(f"| [`{name}`]({name}.md) | {summary} |")
    return "# API reference\n\n| module | what it holds |\n|---|---|\n" + "\n".join(rows) + "\n"
