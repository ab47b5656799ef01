"""A clip of a person: its pictures, the person in them, key points and masks."""
