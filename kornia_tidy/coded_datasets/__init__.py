"""Data sets rendered once and for all: coded captures on disk, in folders or in shards, and how to train on them."""

from kornia_tidy.coded_datasets.captures import CodedCaptures
from kornia_tidy.coded_datasets.layout import Layout
from kornia_tidy.coded_datasets.render_scenes import Rendered, render_scenes, shard_items_within

__all__ = ["CodedCaptures", "Layout", "Rendered", "render_scenes", "shard_items_within"]
