"""Metadata of a release that follows from the address of the repository: links, and a README that works on PyPI."""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


class Repository(MetadataHookInterface):
    """Add ``project.urls`` and the README with absolute links, from ``repository`` in pyproject.toml; empty: no links."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the dynamic fields."""
        repository, text = self.config["repository"], (Path(self.root) / "README.md").read_text()
        if repository:
            files = f"{repository}/raw/v{metadata['version']}/"
            text = re.sub(r"\]\((?!https?:|#)", f"]({files}", text)
            metadata["urls"] = {
                "Source": repository,
                "Issues": f"{repository}/issues",
                "Changelog": f"{repository}/blob/main/CHANGELOG.md",
            }
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
