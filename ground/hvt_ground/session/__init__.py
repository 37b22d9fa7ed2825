"""From the link of one edge to its sessions: `GroundLink`, `EdgeThread`, `EdgeSessions` and `GroundSession`."""
