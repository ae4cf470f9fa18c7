"""What is told to the outside: MQTT."""
