"""What a training video shows of a person before any prior is asked: body, hidden parts, light."""
