"""Elements and correspondences."""
