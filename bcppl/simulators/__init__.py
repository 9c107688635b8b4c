"""What the sensors would read: camera and renderer, contact physics, from wrench to contacts."""
