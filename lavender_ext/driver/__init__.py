"""Methods as workspace, start and step on plain structs, for any host: `driver.pxd` says which, over what."""
