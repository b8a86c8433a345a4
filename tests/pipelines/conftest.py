"""The scripts are run by test_pipelines.py, in a folder of scenes, and not collected as modules."""

collect_ignore_glob = ["scripts/*"]
