"""The provider's side of calls: `@service`, validation, registration, and the dispatch of incoming calls."""
