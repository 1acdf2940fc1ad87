"""Recordings as they come, and the jobs that are made of them: bags, depth images, point clouds."""
