"""What is on the wire: keys, messages, their bytes, and types as JSON Schema. Pure: nothing here sends."""
