"""A recording of a cylinder by a camera on a flange, as a job: used by ``cylinder_job.py``."""
