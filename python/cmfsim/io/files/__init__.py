"""What every reader and writer of files stands on: safe writing, documents, text, archives."""
