"""Hooks of `make docs`: pages for files outside docs/, and what is generated: commands, defaults, notebook."""

from __future__ import annotations

import json
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from typer.main import get_command

from crkr.client.cli.subcommands import build
from crkr.protocol import TaskSpec

REPOSITORY = Path(__file__).parents[1]
ROOT_PAGES = ("ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md")
OUTSIDE = re.compile(r"\]\(((?:\.\./)+[\w./-]+)\)")
LANGUAGES = {".py": "python", ".toml": "toml", ".json5": "json", ".yaml": "yaml", ".sh": "sh", ".md": "md"}
COMMANDS = "<!-- commands -->"
DEFAULTS = "<!-- defaults -->"
NOTEBOOK = re.compile(r"<!-- notebook: ([\w./-]+) -->")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages beside docs/, and one for each file or folder outside it that a page links to."""
    for name in ROOT_PAGES:
        text = (REPOSITORY / name).read_text(encoding="utf-8")
        text = text.replace("](docs/", "](").replace("](examples/", "](../examples/")
        files.append(File.generated(config, name, content=text))
    pages = files.documentation_pages()
    linked = {_outside(file.src_uri, target) for file in pages for target in OUTSIDE.findall(file.content_string)}
    for path in sorted(path for path in linked if path is not None and path not in ROOT_PAGES):
        files.append(File.generated(config, f"files/{path}.md", content=_listing(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Leads links out of docs/ to the pages of those files, and fills in what is generated."""
    del config, files
    here = page.file.src_uri

    def led(match: re.Match[str]) -> str:
        path = _outside(here, match[1])
        if path is None:
            return match[0]
        target = path if path in ROOT_PAGES else f"files/{path}.md"
        return f"]({posixpath.relpath(target, posixpath.dirname(here) or '.')})"

    markdown = NOTEBOOK.sub(lambda match: _notebook(REPOSITORY / match[1]), OUTSIDE.sub(led, markdown))
    for marker, written in ((COMMANDS, _commands), (DEFAULTS, _defaults)):
        if marker in markdown:
            markdown = markdown.replace(marker, written())
    return markdown


def _outside(page: str, target: str) -> str | None:
    """The file of the repository that a page of docs/ links to; None for another page of docs/."""
    path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), target))
    return None if path.startswith("docs/") else path


def _listing(path: str) -> str:
    """A page with the text of a file, or of the files of a folder."""
    place = REPOSITORY / path
    found = [place] if place.is_file() else sorted(file for file in place.rglob("*") if file.suffix in LANGUAGES)
    parts = [f"# {path}"]
    for file in found:
        if file != place:
            parts.append(f"## {file.relative_to(place)}")
        parts.append(f"````{LANGUAGES.get(file.suffix, 'text')}\n{file.read_text(encoding='utf-8').rstrip()}\n````")
    return "\n\n".join(parts) + "\n"


def _notebook(path: Path) -> str:
    """A notebook's cells as text and programs."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    texts = ("".join(cell["source"]) for cell in cells)
    return "\n\n".join(
        text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```"
        for cell, text in zip(cells, texts, strict=True)
    )


def _defaults() -> str:
    """The least specification with all its defaults."""
    axis = {"name": "x", "low": 0.0, "high": 1.0}
    spec = TaskSpec.from_dict({"name": "my-task", "state": [axis], "goal": [axis]})
    return f"```json\n{json.dumps(spec.to_dict(), indent=2)}\n```"


def _commands() -> str:
    """All commands with their help, arguments and options."""
    root: Any = get_command(build(["--help"]))
    return "\n\n".join(part for name, command in root.commands.items() for part in _command(f"crkr {name}", command))


def _command(name: str, command: Any) -> list[str]:
    inner = getattr(command, "commands", None)
    if inner is not None:
        return [part for sub, one in inner.items() for part in _command(f"{name} {sub}", one)]
    said, _, example = (command.help or "").partition("\n\nExample: ")
    parameters = [parameter for parameter in command.params if not getattr(parameter, "hidden", False)]
    rows = ["| | | default |", "|---|---|---|", *(_row(parameter) for parameter in parameters)]
    shown = f"```sh\n{' '.join(example.split())}\n```" if example else ""
    return [f"## {name}", said, shown, "\n".join(rows)]


def _row(parameter: Any) -> str:
    names = [parameter.name] if parameter.param_type_name == "argument" else parameter.opts + parameter.secondary_opts
    default = parameter.default
    plain = default is not None and not isinstance(default, bool) and not callable(default)
    told = " ".join((parameter.help or "").split()).replace("|", "\\|").replace("<", "&lt;")
    return f"| {' '.join(f'`{name}`' for name in names)} | {told} | {f'`{default}`' if plain else ''} |"
