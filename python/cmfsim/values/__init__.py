"""The plain values that stages hand to each other: frozen, checked where made, no files."""
