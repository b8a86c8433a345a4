"""The commands of `kornia-tidy`, one to a file: dataclasses of settings with a method run().

Arguments come in, files and lines of a report go out. ``parser.py`` makes options of settings; ``shared.py`` has the
settings that several commands take. Only ``run()`` and its callees import torch: ``--help`` comes at once. Read
``info.py`` first, then ``simulate.py``.
"""
