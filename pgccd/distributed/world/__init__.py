"""A scene of the user's own, spread over ranks."""
