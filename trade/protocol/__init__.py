"""The wire format: keys, messages, their bytes, and types as JSON Schema. Pure: nothing here sends."""
