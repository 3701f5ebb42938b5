"""From a CAD model and a scan to the ranked poses of a whole bin."""
