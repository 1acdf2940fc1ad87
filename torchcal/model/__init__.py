"""Robot, sensor, range image, world and job: what is believed before anything is estimated."""
