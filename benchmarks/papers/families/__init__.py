"""What figures of one kind share: their table, their picture and their verdict."""
