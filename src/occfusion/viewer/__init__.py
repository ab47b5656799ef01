"""Looking at runs in a browser: what is shown, and the page that viser serves."""
