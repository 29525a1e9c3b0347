"""mphDRR's version, the same as in pyproject.toml and blender_manifest.toml."""

VERSION = "0.1.0"
