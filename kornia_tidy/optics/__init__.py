"""Light: from phase masks and defocus to point spread functions."""
