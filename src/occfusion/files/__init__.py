"""Reading and writing files: nothing read is ever executed, nothing written is ever half there."""
