"""From cameras to poses that others can see, as they come."""
