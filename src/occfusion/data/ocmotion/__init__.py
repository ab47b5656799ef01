"""OcMotion: as released with CHOMP, and as Wild2Avatar cut it."""
