"""What the operation changes: motions of bone, bodies cut loose, the scan afterwards."""
