"""From captures back to scenes: all-in-focus images and depth maps."""
