"""Pure. Every message that crosses a border, and its codec."""
