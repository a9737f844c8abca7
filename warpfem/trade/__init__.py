"""The trade between speed and accuracy of a scene: settings swept, errors against a reference, cost, and the front."""
