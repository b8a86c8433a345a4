"""Planning of captures: candidates are tried by their predicted errors and counted operations, the cheapest is taken.

Read ``planner.py`` first. ``plan.py`` plans a scene, ``wide_plan.py`` one of wide blur.
"""
