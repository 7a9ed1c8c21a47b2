"""One thin file a node: decode, one core call, publish."""
