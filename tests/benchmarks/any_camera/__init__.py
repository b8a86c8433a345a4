"""Training and scores of the network ``any-camera``, which restores the captures of any camera."""
