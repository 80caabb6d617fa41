"""The hooks of mkdocs.yml: pages of files outside docs/, the notebook, pages not in the nav."""

from __future__ import annotations

import logging
import sys
import tempfile
from pathlib import Path

from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "docs"))

from website.links import is_code, page_of, rewritten, targets  # noqa: E402

log = logging.getLogger("mkdocs.hooks.gamba_warp")
# Markdown outside docs/ that is part of the site even if no page links to it.
ALWAYS = (
    *("CONTRIBUTING.md", "CHANGELOG.md", "THIRD_PARTY.md", "eval/README.md"),
    *("kernels/rasterize/CUDA.md", "kernels/selective_scan/CUDA.md"),
)
# Place on the site -> file of the repository, for pages that do not lie in docs/ under their name.
_origin: dict[str, str] = {}
_tree: list[tempfile.TemporaryDirectory] = []


@event_priority(100)
def on_config(config):
    """Show mkdocstrings the installed layout of the package: kernels/ is gamba_warp.kernels."""
    tree = tempfile.TemporaryDirectory(prefix="gamba-warp-site-")
    _tree.append(tree)
    package = Path(tree.name) / "gamba_warp"
    package.mkdir()
    for path in (ROOT / "gamba_warp").iterdir():
        (package / path.name).symlink_to(path)
    for part in ("kernels", "train", "eval"):
        (package / part).symlink_to(ROOT / part)
    config.plugins["mkdocstrings"].config.handlers["python"]["paths"] = [tree.name]
    return config


def on_files(files: Files, config) -> Files:
    """Add the pages of files outside docs/ that are linked, directly or indirectly."""
    waiting = [f"docs/{file.src_uri}" for file in files.documentation_pages()]
    notebooks = sorted((ROOT / "docs").rglob("*.ipynb"))
    waiting += [str(path.relative_to(ROOT)) for path in notebooks] + list(ALWAYS)
    done = set()
    while waiting:
        path = waiting.pop()
        if path in done or not (ROOT / path).is_file():
            continue  # a link to nothing: mkdocs names it, with the page
        done.add(path)
        page = page_of(path)
        if files.get_file_from_path(page) is None:
            _origin[page] = path
            files.append(File.generated(config, page, content=_content(path)))
        if path.endswith(".md"):
            waiting += targets((ROOT / path).read_text(encoding="utf-8"), path)
    files.append(File.generated(config, "commands.md", content=command_reference()))
    _keep_what_is_there(config.nav or [], files)
    return files


def on_page_markdown(markdown: str, page, config, files) -> str:
    """Turn links between files of the repository into links between pages.

    Pages of the project's own studies and credits are left out of the search.
    """
    if page.file.src_uri.startswith("lab/") or page.file.name in ("THIRD_PARTY", "ATTRIBUTION"):
        page.meta.setdefault("search", {"exclude": True})
    path = _origin.get(page.file.src_uri, f"docs/{page.file.src_uri}")
    if is_code(path) or path.endswith(".ipynb"):
        return markdown
    return rewritten(markdown, path, page.file.src_uri)


def on_nav(nav, config, files):
    """Put pages that mkdocs.yml does not name at the end, so that a new page is visible."""
    from mkdocs.structure.nav import Section
    from mkdocs.structure.pages import Page

    own = ("api/", "code/", "repository/", "images/")
    left = [
        file.page or Page(None, file, config)
        for file in files.documentation_pages()
        if file.page is None or file.page not in nav.pages
    ]
    left = [page for page in left if not page.file.src_uri.startswith(own)]
    if left:
        log.info("not in the navigation: %s", ", ".join(page.file.src_uri for page in left))
        section = Section("More", left)
        for page in left:
            page.parent = section
        nav.items.append(section)
    return nav


def on_shutdown():
    """Remove the folder of links for mkdocstrings."""
    while _tree:
        _tree.pop().cleanup()


def command_reference() -> str:
    """Return the help of every command, from its parser, as Markdown."""
    from gamba_warp import cli

    helps = ((name, cli.help_text(name, cli.load_command(name), [])) for name in cli.COMMANDS)
    return "# The commands\n" + "".join(
        f"\n## gamba {name}\n\n```text\n{text}\n```\n" for name, text in helps
    )


def _content(path: str) -> str | bytes:
    """Content of the page of a file outside docs/."""
    if path.endswith(".ipynb"):
        return _notebook(ROOT / path)
    if not is_code(path):
        data = (ROOT / path).read_bytes()
        return data.decode() if path.endswith(".md") else data
    language = {".py": "python", ".sh": "bash", ".cff": "yaml", ".cfg": "ini"}
    text = (ROOT / path).read_text(encoding="utf-8").rstrip()
    kind = language.get(Path(path).suffix, "text")
    return f"---\nsearch:\n  exclude: true\n---\n\n# {path}\n\n````{kind}\n{text}\n````\n"


def _notebook(path: Path) -> str:
    """A notebook as Markdown, with its images inside."""
    import base64

    from nbconvert import MarkdownExporter

    text, resources = MarkdownExporter().from_filename(str(path))
    for name, data in resources["outputs"].items():
        inside = f"data:image/{Path(name).suffix[1:]};base64,{base64.b64encode(data).decode()}"
        text = text.replace(f"]({name})", f"]({inside})")
    return text


def _keep_what_is_there(entries: list, files: Files) -> None:
    """Remove entries without a page from the navigation."""
    for entry in list(entries):
        for value in entry.values() if isinstance(entry, dict) else [entry]:
            if isinstance(value, list):
                _keep_what_is_there(value, files)
            if value == [] or (isinstance(value, str) and files.get_file_from_path(value) is None):
                log.info("the navigation names %s, which does not exist", value or entry)
                entries.remove(entry)
