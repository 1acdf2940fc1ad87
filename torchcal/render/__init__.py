"""From a model and a pose to the range image that the sensor would measure."""
