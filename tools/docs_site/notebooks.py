"""Notebooks as pages of the site, with the outputs that they hold."""

from __future__ import annotations

from pathlib import PurePosixPath

import nbformat
from mkdocs.structure.files import File
from nbconvert import MarkdownExporter


def page_of_notebook(file: File) -> dict[str, str | bytes]:
    """Names of files of the site to their contents: the page, and the pictures that it shows.

    The notebook is not executed: its outputs are those that it holds, see CONTRIBUTING.md.
    """
    notebook = nbformat.reads(file.content_string, as_version=4)  # type: ignore[no-untyped-call]
    path = PurePosixPath(file.src_uri)
    exporter = MarkdownExporter()  # type: ignore[no-untyped-call]
    body, resources = exporter.from_notebook_node(
        notebook, resources={"output_files_dir": f"{path.stem}-files", "unique_key": path.stem}
    )
    link = f"\nThis page is a notebook: [{path.name}]({path.name}).\n"
    pictures = {str(path.parent / name): content for name, content in resources["outputs"].items()}
    return {str(path.with_suffix(".md")): body.replace("\n", link, 1), **pictures}
