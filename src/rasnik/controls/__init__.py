"""Values for control systems: EPICS, MQTT, Prometheus."""
