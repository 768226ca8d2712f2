"""What the terminal shows: findings, reports, causes of errors."""
