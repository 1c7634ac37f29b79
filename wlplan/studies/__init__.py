"""Questions asked of worlds and plans."""
