"""Links in the built documentation: README.md is its first page, and what is outside of docs/ is shown or named."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

LINK = re.compile(r"(?P<image>!?)\[(?P<text>[^\]]*)\]\((?P<target>[^)#:]+)(?P<anchor>#[^)]*)?\)")


def on_files(files: Files, config: Any) -> None:
    """Add the README as the first page."""
    files.append(File.generated(config, "index.md", abs_src_path=str(Path(config.docs_dir).parent / "README.md")))


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Copy images from elsewhere in the repository, and name other files there in place of a link."""
    docs = Path(config.docs_dir)
    root, folder = docs.parent, Path(page.file.abs_src_path).parent

    def resolved(match: re.Match[str]) -> str:
        path = (folder / match["target"]).resolve()
        if not path.exists():
            raise PluginError(f"{page.file.src_uri} links to {match['target']}, which does not exist")
        if path.is_relative_to(docs):
            place = path.relative_to(docs).as_posix()
        elif match["image"]:
            place = path.relative_to(root).as_posix()
            if files.get_file_from_path(place) is None:
                files.append(File.generated(config, place, abs_src_path=str(path)))
        else:
            name = path.relative_to(root).as_posix()
            return f"`{name}`" if match["text"].strip("`") == name else f"{match['text']} (`{name}`)"
        return f"{match['image']}[{match['text']}]({place}{match['anchor'] or ''})"

    return LINK.sub(resolved, markdown)
