"""Coded data sets: scenes photographed once, stored in folders or shards, and read for training.

A camera and a data set of scenes come in, files and a data set of captures go out. Read ``render_scenes.py`` first.
"""

from kornia_tidy.training.coded_datasets.captures import CodedCaptures
from kornia_tidy.training.coded_datasets.layout import Layout
from kornia_tidy.training.coded_datasets.render_scenes import Rendered, render_scenes, shard_items_within
from kornia_tidy.training.coded_datasets.shard_samples import decode_sample

__all__ = ["CodedCaptures", "Layout", "Rendered", "decode_sample", "render_scenes", "shard_items_within"]
