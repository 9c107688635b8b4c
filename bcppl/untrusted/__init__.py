"""What others write: XML without entities, JSON without surprises, and text that is safe to print."""
