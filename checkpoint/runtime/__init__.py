"""Help our own processes start fast and stay small: late imports, parallel work, the allocator. Every package may import it."""
