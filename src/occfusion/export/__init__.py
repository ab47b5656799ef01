"""Taking an avatar away: Gaussians for viewers, a page that plays it, a mesh."""
