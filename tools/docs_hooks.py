"""What mkdocs asks of the project: pages that are made of the code itself, so that none of them can go stale."""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from docs_site.api_page import api_page
from docs_site.channel_page import channel_tables
from docs_site.command_page import command_page
from docs_site.conventions import link_conventions, spatial_frames
from docs_site.notebooks import page_of_notebook
from docs_site.schema_page import schema_tables
from docs_site.sign_drawings import euler_parameters, inertia_signs

ROOT = Path(__file__).resolve().parents[1]
# Pages with a line `<!-- made: NAME -->`, which what is made replaces.
MADE = re.compile(r"^<!-- made: ([\w-]+) -->$", re.MULTILINE)
MAKERS = {
    "api": api_page,
    "channels": channel_tables,
    "command-line": command_page,
    "system-file": schema_tables,
}
DRAWINGS = {
    "how-to/spatial-frames.svg": spatial_frames,
    "how-to/link-conventions.svg": link_conventions,
    "how-to/inertia-signs.svg": inertia_signs,
    "how-to/euler-parameters.svg": euler_parameters,
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that lie outside docs/, the notebooks' pages and the drawings."""
    for name, path in (("index.md", "README.md"), ("contributing.md", "CONTRIBUTING.md")):
        text = (ROOT / path).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=_moved_into_docs(text)))
    for file in [file for file in files if file.src_uri.endswith(".ipynb")]:
        for name, content in page_of_notebook(file).items():
            files.append(File.generated(config, name, content=content))
    for name, draw in DRAWINGS.items():
        files.append(File.generated(config, name, content=draw()))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Put what is made of the code where a page asks for it."""
    return MADE.sub(lambda found: MAKERS[found[1]](), markdown)


def _moved_into_docs(text: str) -> str:
    """Links of a page that lies beside docs/, as they are within it."""
    text = re.sub(r"\]\(docs/", "](", text).replace(".ipynb)", ".md)")
    return text.replace("](CONTRIBUTING.md", "](contributing.md").replace(
        "](LICENSE)", "](https://www.apache.org/licenses/LICENSE-2.0)"
    )
